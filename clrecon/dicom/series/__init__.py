"""Files to series, and what is known of them."""
