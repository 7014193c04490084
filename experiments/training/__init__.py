"""Training of learned policies: `lpv-track train`."""
