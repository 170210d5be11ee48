"""The pipeline: photo and prior in, pose out. Read localizer.py first."""
