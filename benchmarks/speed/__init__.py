"""Speed of this machine: how long frames take while something moves, what they ask of the GPU, and the peaks."""
