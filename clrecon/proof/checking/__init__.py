"""What every check of the self-test needs."""
