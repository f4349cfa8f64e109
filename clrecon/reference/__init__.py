"""Slow, plain numpy twins of the device operators: the specification, the test and the debugger of each."""
