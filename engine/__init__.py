"""The science: photos → cameras → Gaussians → features → probability → fruits → files. Never imports bpy."""
