"""What any program needs, nothing of CT: files, memory, text, gates, progress, the words for parameters."""
