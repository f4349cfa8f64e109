"""What the stages of a mesh cost, beside a peer."""
