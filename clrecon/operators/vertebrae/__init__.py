"""Single vertebrae of a label map: their solid bone, and what is inside of it."""
