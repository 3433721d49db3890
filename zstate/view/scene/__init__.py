"""The 3D scene: robot meshes, frame axes, names, parent lines and trails."""
