"""`python -m gelflow`."""

import sys

from gelflow.cli import main

sys.exit(main())
