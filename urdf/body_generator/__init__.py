"""Generator of the bundled human bodies: closed triangle meshes and URDF from body measures."""
