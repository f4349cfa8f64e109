"""Twins of `clrecon.operators.surface`, and the derivation of their tables."""
