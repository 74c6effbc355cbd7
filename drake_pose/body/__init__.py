"""What is looked at: links, joints, limits and surfaces of an articulated object."""
