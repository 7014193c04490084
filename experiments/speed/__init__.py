"""Speed: what the compiled environments are measured against."""
