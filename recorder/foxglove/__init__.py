"""Recordings and running rigs in the Foxglove app: WebSocket server, and layout."""
