"""Registration of cameras from silhouettes or pictures of a body at known joint positions."""
