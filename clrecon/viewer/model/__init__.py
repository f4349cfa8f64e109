"""What a view shows, and every change of it, without a toolkit or a device."""
