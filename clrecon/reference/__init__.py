"""Reference: slow, plain numpy twins of the device operators, which specify, test and help to debug them."""
