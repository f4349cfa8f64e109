"""Looks: colours and opacities of pictures, by transfer functions, lighting, presets and windows."""
