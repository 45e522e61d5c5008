"""The platform's pose from AprilTags in camera images, and its measured clearance."""
