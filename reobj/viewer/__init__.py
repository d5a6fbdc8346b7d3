"""Pictures of results: the viewer scene.html, the overlay video, local servers."""
