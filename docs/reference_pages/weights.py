"""The page of published weights: which file each recipe starts from, and what is known of it."""

from __future__ import annotations

from reference_pages.markdown import code, page, table
from rgbt.config.compose import available
from rgbt.runs.starts import RECIPES, STARTS


def weights_page() -> str:
    """Recipes by the file that they start from, and every file with its digest."""
    rows = []
    for recipe in RECIPES:
        names = ", ".join(map(code, recipe.named(available("experiment"))))
        for model, files in recipe.by_network().items() or [(f"{recipe.model}*", [])]:
            text = " or ".join(map(code, files)) or "none: random values"
            rows.append([names, code(model), text, recipe.source if names else ""])
            names = ""  # the next network is of the same recipe
    return page(
        "# Published weights",
        "A recipe is an experiment at `scale=paper`. This page names the public file that each one "
        "starts from. Download the file yourself; `rgbt` never does. Then train:",
        "<!-- needs: MFNet, ImageNet weights -->\n```bash\nrgbt run +experiment=crm scale=paper "
        "dataset.root=/data/MFNet \\\n  pretrained=swin_small_patch4_window7_224.pth\n```",
        "`pretrained` initialises the network of the run, or that of its first upstream run.",
        "## Files by recipe",
        "`rgbt run` and `rgbt reproduce ... dry_run=true` name the file that a run lacks. Of "
        "several files, the first is the one to get.",
        table(["Recipes", "`model=`", "Files", "Source"], rows),
        "## Files",
        "A digest is the beginning of the SHA-256, where it is known. `rgbt weights inspect FILE` "
        "prints the SHA-256 of your file, the recipes of a published file, and a remark where a "
        "file of that name has another digest.",
        table(
            ["File", "Architecture, pretraining", "Published at", "`model=`", "Digest"],
            [
                [
                    code(start.file),
                    start.trained_on,
                    start.origin,
                    ", ".join(map(code, start.models)),
                    code(start.digest[:8]) or "not stated",
                ]
                for start in STARTS
            ],
        ),
        "## No file is converted by hand",
        "- Swin Transformers load from the original files, from files that timm has saved "
        "(`model.safetensors` or `pytorch_model.bin` of `timm/swin_*_patch4_window7_224.ms_in1k`, "
        "or `torch.save(model.state_dict(), ...)`). "
        "timm 0.9 and later names the patch merging after the stage behind it; this is "
        "recognised.\n"
        "- The thermal stem gets the mean of the RGB stem where it has one channel, as released.\n"
        "- The file may hold the tensors at its top, or below `model` or `state_dict`.\n"
        "- Files in the names of Hugging Face Transformers (`microsoft/swin-*`, `nvidia/mit-*`) "
        "and of MMSegmentation are not read. Take the file of the table.",
    )
