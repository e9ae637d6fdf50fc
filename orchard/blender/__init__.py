"""The scene in Blender: objects, materials, rendering."""
