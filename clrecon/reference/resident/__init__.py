"""Twins of `clrecon.operators.resident`."""
