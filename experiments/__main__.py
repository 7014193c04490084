"""`python -m experiments` is `lpv-track`."""

import sys

from experiments.cli import main

sys.exit(main())
