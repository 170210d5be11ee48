"""What all rooms share: geometry, cameras, photos, and where arrays lie."""
