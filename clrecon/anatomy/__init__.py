"""What HU show of the body: bone and its iso value, the table beside it, air, the line of the spine."""
