"""Training of the embedded model: training images, training and evaluation."""
