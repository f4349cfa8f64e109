"""Pictures that move: cameras that turn, and their files."""
