"""Movies: turning cameras, and files of moving pictures."""
