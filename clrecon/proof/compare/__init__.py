"""The compare job: all methods of surfaces, clouds and ray casting on one scan, side by side, as a page and as JSON."""
