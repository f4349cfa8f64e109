"""The self-test: every kernel is compared with its numpy twin, or with an exact truth, on the device of the user."""
