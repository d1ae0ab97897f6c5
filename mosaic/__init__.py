"""Images to homographies to panorama: direct registration and compositing for rotating cameras."""
