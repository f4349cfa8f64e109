"""Smoothing and decimation within a bound."""
