"""Code to start from: an environment of one's own, a trained agent as a program without Python."""
