"""The science of FruitLangs: photos → cameras → Gaussians → features → probability → fruits → files. Never imports bpy."""
