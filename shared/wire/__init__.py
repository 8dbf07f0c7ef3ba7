"""Generated from proto/pointslam/v1 by proto/generate.sh; not to be edited."""
