"""The masked transformer decoder, in which a query attends to the pixels of its own mask."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.mask2former.pixel_decoder import NUM_LEVELS, HeadShape, PixelPyramid, sine_code


class QueryAttention(nn.Module):
    """Multi-head attention with the parameter layout of `torch.nn.MultiheadAttention`.

    That module cannot take one mask for all heads of a sample without repeating it.
    """

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.in_proj_weight = nn.Parameter(torch.empty(3 * dim, dim))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * dim))
        self.out_proj = nn.Linear(dim, dim)
        nn.init.xavier_uniform_(self.in_proj_weight)
        nn.init.xavier_uniform_(self.out_proj.weight)
        nn.init.zeros_(self.out_proj.bias)

    def forward(self, query: Tensor, key: Tensor, value: Tensor, allowed: Tensor | None) -> Tensor:
        """(B, Q, C), (B, S, C) and (B, S, C) -> (B, Q, C).

        `allowed` (B, Q, S) bool says what may be read, the same for all heads; None: everything.
        """
        weights, biases = self.in_proj_weight.chunk(3), self.in_proj_bias.chunk(3)
        q, k, v = (
            F.linear(x, w, b).view(*x.shape[:2], self.heads, -1).transpose(1, 2)
            for x, w, b in zip((query, key, value), weights, biases, strict=True)
        )
        mask = None if allowed is None else allowed[:, None]
        if q.device.type == "cpu" and q.dtype in (torch.bfloat16, torch.float16):
            # The gradient takes up to three times as long in bfloat16 as in single precision.
            with torch.autocast("cpu", enabled=False):
                out = F.scaled_dot_product_attention(q.float(), k.float(), v.float(), mask)
        else:
            out = F.scaled_dot_product_attention(q, k, v, mask)
        projected: Tensor = self.out_proj(out.transpose(1, 2).flatten(2))
        return projected


class AttentionLayer(nn.Module):
    """Queries read one level, or each other; added, then normalised.

    `name` is that of the attention in the release.
    """

    def __init__(self, name: str, dim: int, heads: int) -> None:
        super().__init__()
        self.add_module(name, QueryAttention(dim, heads))
        self.norm = nn.LayerNorm(dim)

    def forward(
        self, queries: Tensor, placed: Tensor, memory: tuple[Tensor, Tensor], allowed: Tensor | None
    ) -> Tensor:
        """(B, Q, C), without and with position, and keys and values (B, S, C) -> (B, Q, C)."""
        attention, norm = self.children()
        out: Tensor = norm(queries + attention(placed, *memory, allowed))
        return out


class FfnLayer(nn.Module):
    """Linear, ReLU, linear; added, then normalised."""

    def __init__(self, dim: int, ffn_dim: int) -> None:
        super().__init__()
        self.linear1 = nn.Linear(dim, ffn_dim)
        self.linear2 = nn.Linear(ffn_dim, dim)
        self.norm = nn.LayerNorm(dim)
        for layer in (self.linear1, self.linear2):
            nn.init.xavier_uniform_(layer.weight)

    def forward(self, queries: Tensor) -> Tensor:
        """(B, Q, C) -> (B, Q, C)."""
        out: Tensor = self.norm(queries + self.linear2(F.relu(self.linear1(queries))))
        return out


class MaskEmbed(nn.Module):
    """Three linear layers with ReLU between them: query -> mask embedding."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(dim, dim) for _ in range(3))

    def forward(self, x: Tensor) -> Tensor:
        """(B, Q, C) -> (B, Q, C)."""
        first, second, third = self.layers
        out: Tensor = third(F.relu(second(F.relu(first(x)))))
        return out


class Predictor(nn.Module):
    """Query decoder with a prediction before the first and after every layer.

    Source: Mask2Former, Sec. 3.2, Eq. (1)-(2).

    Layer i reads level i mod 3 (strides 32, 16, 8).
    """

    def __init__(self, shape: HeadShape) -> None:
        super().__init__()
        dim, heads, count = shape.hidden_dim, shape.attention_heads, range(shape.decoder_layers)
        self.transformer_self_attention_layers = nn.ModuleList(
            AttentionLayer("self_attn", dim, heads) for _ in count
        )
        self.transformer_cross_attention_layers = nn.ModuleList(
            AttentionLayer("multihead_attn", dim, heads) for _ in count
        )
        self.transformer_ffn_layers = nn.ModuleList(
            FfnLayer(dim, shape.decoder_ffn_dim) for _ in count
        )
        self.decoder_norm = nn.LayerNorm(dim)
        self.query_feat = nn.Embedding(shape.num_queries, dim)
        self.query_embed = nn.Embedding(shape.num_queries, dim)
        self.level_embed = nn.Embedding(NUM_LEVELS, dim)
        self.class_embed = nn.Linear(dim, shape.num_classes + 1)
        self.mask_embed = MaskEmbed(dim)

    def forward(self, pyramid: PixelPyramid) -> tuple[Tensor, Tensor]:
        """Predictions of the initial queries and after each layer, L in all, the last one final.

        Returns:
            class_logits: (L, B, Q, K + 1), last column = no object.
            mask_logits: (L, M, Q, H/4, W/4) of the first M samples, those of `PixelPyramid.fine`;
                a view of memory ordered M, L, Q, H/4, W/4.
        """
        memories = []  # keys and values of the three levels, each (B, S_l, C)
        every_level = zip(pyramid.tokens, pyramid.levels, self.level_embed.weight, strict=True)
        for tokens, hw, embed in every_level:
            values = tokens + embed
            memories.append((values + sine_code(hw, values.shape[-1], values.device), values))
        position = self.query_embed.weight
        queries = self.query_feat.weight.expand(pyramid.tokens[0].shape[0], -1, -1)
        normed: list[Tensor] = [self.decoder_norm(queries)]
        embeds: list[Tensor] = [self.mask_embed(normed[0])]
        layers = zip(
            self.transformer_cross_attention_layers,
            self.transformer_self_attention_layers,
            self.transformer_ffn_layers,
            strict=True,
        )
        for index, (cross_attention, self_attention, ffn) in enumerate(layers):
            level = index % NUM_LEVELS
            # Read where the own mask has probability 1/2 or more, if anywhere. Resizing is linear:
            # a resized mask is the product of the embedding with resized features, which costs the
            # size of the level instead of the size of the mask.
            with torch.no_grad():
                inside = _mask_logits(embeds[-1], pyramid, pyramid.reduced[level]) >= 0
                allowed = inside | ~inside.any(-1, keepdim=True)
            queries = cross_attention(queries, queries + position, memories[level], allowed)
            placed = queries + position
            queries = ffn(self_attention(queries, placed, (placed, queries), None))
            normed.append(self.decoder_norm(queries))
            embeds.append(self.mask_embed(normed[-1]))

        # The masks of all layers are one matrix product: no copy, one gradient of the features.
        class_logits = self.class_embed(torch.stack(normed))
        embed = torch.cat(embeds, dim=1)[: pyramid.fine.shape[0]]
        masks = _mask_logits(embed, pyramid, pyramid.fine.flatten(2))
        masks = masks.view(masks.shape[0], len(embeds), -1, *pyramid.fine.shape[-2:])
        return class_logits, masks.transpose(0, 1)


def _mask_logits(embed: Tensor, pyramid: PixelPyramid, fine: Tensor) -> Tensor:
    """(B, Q, C) mask embeddings times mask features of `fine` (B, C, pixels) -> (B, Q, pixels)."""
    offset = embed @ pyramid.bias[:, None]
    return torch.baddbmm(offset.expand(-1, -1, fine.shape[-1]), embed @ pyramid.weight, fine)
