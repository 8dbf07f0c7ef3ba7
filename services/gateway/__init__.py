"""Gateway: the only door of the system, for HTTP, WebSocket and gRPC; no torch, no open3d."""
