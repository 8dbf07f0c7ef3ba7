"""What the services share: values, geometry, the wire and the process; no torch, no open3d."""
