"""What a command does: estimate, capture, register, audit, masks, batch, walk."""
