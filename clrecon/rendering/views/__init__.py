"""Where a picture is taken from: cameras, clipping, planes and centre lines."""
