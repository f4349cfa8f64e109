"""Primitives of other operators: scans, compaction and union-find."""
