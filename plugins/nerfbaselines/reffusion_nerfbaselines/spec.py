"""What nerfbaselines is told of: it finds this module by its entry point."""

from __future__ import annotations

from nerfbaselines import register

PROTOCOL, DATASET, METHOD = "spinnerf-box", "spinnerf", "reffusion"
SCENES = ("1", "2", "3", "4", "7", "9", "10", "12", "book", "trash")

register({"id": PROTOCOL, "evaluation_protocol_class": "reffusion_nerfbaselines.protocol:BoxProtocol"})
register({"id": DATASET, "load_dataset_function": "reffusion_nerfbaselines.dataset:load"})
register(
    {
        "id": DATASET,
        "download_dataset_function": "reffusion_nerfbaselines.dataset:download",
        "evaluation_protocol": PROTOCOL,
        "metadata": {
            "id": DATASET,
            "name": "SPIn-NeRF",
            "description": "Scenes with an object in 60 training views and without it in 40 test views. Scored in the "
            "bounding box of each test view's mask, 10 % wider on each side.",
            "paper_title": "SPIn-NeRF: Multiview Segmentation and Perceptual Inpainting with Neural Radiance Fields",
            "paper_authors": ["Ashkan Mirzaei"],
            "paper_link": "https://arxiv.org/abs/2211.12254",
            "metrics": ["psnr", "ssim", "lpips_vgg"],  # of those that its pages know; results.json has FLIP
            "default_metric": "psnr",
            "scenes": [{"id": scene, "name": scene} for scene in SCENES],
        },
    }
)
register(
    {
        "id": METHOD,
        "method_class": "reffusion_nerfbaselines.method:RefFusion",
        "backends_order": ["python"],
        "metadata": {
            "name": "RefFusion",
            "description": "An open implementation of RefFusion. A finished run is rendered; RefFusion itself "
            "trains it (`make scene=X all`).",
            "paper_title": "RefFusion: Reference Adapted Diffusion Models for 3D Scene Inpainting",
            "paper_authors": ["Ashkan Mirzaei"],
            "paper_link": "https://arxiv.org/abs/2404.10765",
        },
        "supported_camera_models": ["pinhole"],
        "required_features": ["color"],
        "supported_outputs": ["color", "depth", "accumulation"],
    }
)
