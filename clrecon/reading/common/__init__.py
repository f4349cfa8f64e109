"""What all inputs have in common: what a listing and a certificate say, and whether values and places are plausible."""
