"""When a scan becomes a keyframe; the clouds of keyframes on disk; submaps."""
