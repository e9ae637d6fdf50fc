"""How the embedded encoder is trained: photos, renders, pasted fruit, loss, measures, model card."""
