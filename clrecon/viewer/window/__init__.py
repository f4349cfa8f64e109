"""The window of a view, drawn with VTK."""
