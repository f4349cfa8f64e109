"""What a picture shows in which colours: transfer functions, lighting, presets, windows."""
