"""Small checkpoints of the real classes with random weights, on disk as the hub has them."""

from __future__ import annotations

from pathlib import Path

import torch
from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors
from transformers import (
    CLIPConfig,
    CLIPImageProcessorPil,
    CLIPModel,
    CLIPTokenizer,
    PreTrainedTokenizerFast,
    SamConfig,
    SamImageProcessorPil,
    SamModel,
    SiglipConfig,
    SiglipImageProcessorPil,
    SiglipModel,
)

DIMENSION = 24
LETTERS = "abcdefghijklmnopqrstuvwxyz"
_SMALL = {"hidden_size": 32, "intermediate_size": 48, "num_attention_heads": 2, "num_hidden_layers": 2}
_TEXT = {**_SMALL, "max_position_embeddings": 32}
_VISION = {**_SMALL, "image_size": 32, "patch_size": 8}


def write_clip(folder: Path, *, seed: int = 0, dimension: int = DIMENSION) -> Path:
    """A CLIP whose words are single letters."""
    words = [*LETTERS, *(f"{letter}</w>" for letter in LETTERS), "<|startoftext|>", "<|endoftext|>"]
    vocabulary = {word: number for number, word in enumerate(words)}
    tokenizer = CLIPTokenizer(vocab=vocabulary, merges=[])
    ends = {"bos_token_id": len(words) - 2, "eos_token_id": len(words) - 1, "pad_token_id": len(words) - 1}
    config = CLIPConfig(
        text_config={**_TEXT, "vocab_size": len(words), **ends}, vision_config=_VISION, projection_dim=dimension
    )
    torch.manual_seed(seed)
    CLIPModel(config).save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    CLIPImageProcessorPil(size={"shortest_edge": 32}, crop_size={"height": 32, "width": 32}).save_pretrained(folder)
    return folder


def write_siglip(folder: Path) -> Path:
    """A SigLIP with the kind of tokenizer that SigLIP 2 has: one file, no sentencepiece."""
    words = {word: number for number, word in enumerate(["<pad>", "<eos>", "<unk>", *LETTERS])}
    rules = Tokenizer(models.WordLevel(words, unk_token="<unk>"))
    rules.normalizer = normalizers.Lowercase()
    rules.pre_tokenizer = pre_tokenizers.Split("", "isolated")
    rules.post_processor = processors.TemplateProcessing(single="$A <eos>", special_tokens=[("<eos>", 1)])
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=rules, pad_token="<pad>", eos_token="<eos>", unk_token="<unk>")
    torch.manual_seed(0)
    config = SiglipConfig(text_config={**_TEXT, "vocab_size": len(words)}, vision_config=_VISION)
    SiglipModel(config).save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    SiglipImageProcessorPil(size={"height": 32, "width": 32}).save_pretrained(folder)
    return folder


def write_sam(folder: Path) -> Path:
    """A SAM on a square of 64 pixels."""
    vision = {**_SMALL, "output_channels": 16, "image_size": 64, "patch_size": 8, "mlp_dim": 48, "num_pos_feats": 8}
    vision |= {"window_size": 4, "global_attn_indexes": [1]}
    prompt = {"hidden_size": 16, "image_size": 64, "patch_size": 8, "mask_input_channels": 4}
    mask = {"hidden_size": 16, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 16}
    torch.manual_seed(0)
    model = SamModel(SamConfig(vision_config=vision, prompt_encoder_config=prompt, mask_decoder_config=mask))
    with torch.no_grad():  # random masks are neither sure nor steady: make this one think so
        model.mask_decoder.iou_prediction_head.proj_out.bias += 0.85
        for head in model.mask_decoder.output_hypernetworks_mlps:
            head.proj_out.weight *= 1e6
            head.proj_out.bias *= 1e6
    model.save_pretrained(folder)
    SamImageProcessorPil(
        size={"longest_edge": 64}, pad_size={"height": 64, "width": 64}, mask_size={"longest_edge": 32}
    ).save_pretrained(folder)
    return folder
