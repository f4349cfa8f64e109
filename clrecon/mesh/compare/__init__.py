"""How far meshes lie from each other, from their scan and from what they were, and the gates on it."""
