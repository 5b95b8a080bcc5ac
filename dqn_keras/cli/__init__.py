"""The command line, `dqn-keras`."""
