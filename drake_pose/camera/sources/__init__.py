"""Where pictures come from: folders, videos and live cameras, synchronised by their time stamps."""
