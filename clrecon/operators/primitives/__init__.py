"""Scans, compaction and union-find: what other operators are made of."""
