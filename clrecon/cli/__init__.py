"""The command line: one module per command, imported when the command is called.

Each has ``add_arguments``, which declares its options, and ``run``, which returns the exit code.
"""
