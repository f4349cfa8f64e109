"""What clrecon computes on a device: ``operator(device, inputs..., parameters...)``; inputs are never modified."""
