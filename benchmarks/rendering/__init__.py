"""The renderer of synthetic rooms; render_room.py describes it and is its command."""
