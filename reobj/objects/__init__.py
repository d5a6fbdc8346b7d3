"""Objects: which detections belong to which 3D object, and their fitted shapes."""
