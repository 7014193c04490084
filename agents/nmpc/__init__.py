"""agents/nmpc."""
