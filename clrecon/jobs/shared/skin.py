"""The range of iso values that show the outside of the body, by which a patient can be recognised."""

__all__ = ["SKIN_HU"]

SKIN_HU = (-950.0, -200.0)
"""Iso values between air and fat: the surface is the skin, and in a head scan the face."""
