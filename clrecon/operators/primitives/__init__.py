"""Primitives of other operators: scans, compaction, sorting and union-find."""
