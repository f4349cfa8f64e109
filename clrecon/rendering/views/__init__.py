"""Views: cameras, clipping, planes and centre lines of pictures."""
