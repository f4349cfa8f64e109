"""Corridors through the pedicles of labelled vertebrae: the widest straight lines, and grades of given screws."""
