"""The corridor job: the widest lines through the pedicles of labelled vertebrae, and grades of given screws."""
