"""Read and write files of tensors within a memory budget, without executing their content.

`stored.read_torch_file` reads any supported file; `stored.save` writes one of rgbt with a digest.
"""
