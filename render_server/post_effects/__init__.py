"""What is done to a finished picture so that objects look taken by the camera: bloom, vignetting, blur, noise."""
