"""The command line: a module a command, with ``add_arguments``, and ``run``, which returns the exit code."""
