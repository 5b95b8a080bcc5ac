"""Compiled programs, fast layers and acting in NumPy: the one home of private API of TensorFlow and Keras."""
