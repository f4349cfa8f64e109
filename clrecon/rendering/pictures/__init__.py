"""What comes out: pictures, what is drawn into them, their files, their place in scenes."""
