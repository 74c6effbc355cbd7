"""Jobs of the commands: estimate, capture, register, audit, masks, batch."""
