"""The cloud job: from a CT series or a cloud to a clean cloud of points."""
