"""`python -m dqn_keras` is the command `dqn-keras`."""

import sys

from dqn_keras.cli.options import main

sys.exit(main())
