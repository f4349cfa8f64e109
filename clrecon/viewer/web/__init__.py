"""The view in a browser: a server on this machine, and its page."""
