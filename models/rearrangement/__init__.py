"""Learned rearrangers of other papers, re-implemented on the corrector's network: LEGO-Net and StructDiffusion."""
