"""Groups of commands, and examples of each, as ``--help`` shows them."""

GROUPS = {
    "start here": ("demo", "run", "view", "report"),
    "bring in": ("record", "calibrate", "topics", "data"),
    "fly": ("fly", "sim"),
    "take out": ("export-map", "batch"),
    "depth network": ("depth", "finetune", "distil", "export", "weights"),
    "judge": ("eval", "compare", "bench", "judge", "ablation"),
}
"""Title: commands, in the order of the listing."""

EXAMPLES: dict[str, tuple[str, ...]] = {
    "demo": ("edgeslam demo", "edgeslam demo --world corridor --duration 30 -o runs/corridor"),
    "run": (
        "edgeslam run rgbd_dataset_freiburg1_xyz",
        "edgeslam run flight.mp4 --camera camera.yaml -o runs/flight",
        "edgeslam run flight.bag --topic /cam0/image_raw --topic odom=/odometry",
        "edgeslam run MH_01_easy --start 200 --stride 2 --max-frames 500 --depth none",
        "edgeslam run tello:// --record flights/today",
    ),
    "view": ("edgeslam view runs/flight", "edgeslam view runs/flight --viewer"),
    "report": ("edgeslam report runs/flight", "edgeslam report runs/a runs/b -o comparison.html"),
    "record": ("edgeslam record webcam:0 -o clip --duration 60", "edgeslam record tello:// -o flights/kitchen"),
    "calibrate": (
        "edgeslam calibrate pictures/ --board 8x6 --square 25",
        "edgeslam calibrate webcam:0 --charuco 5x7 --square 30 --marker 22 -o camera.yaml",
    ),
    "topics": ("edgeslam topics flight.mcap",),
    "data": ("edgeslam data list", "edgeslam data get tum_fr1_xyz --agree"),
    "fly": (
        "edgeslam fly home --fly",
        "edgeslam fly goto 3 0 --drone sim://rooms:1 --fly",
        "edgeslam fly explore 120 --fly --back",
        "edgeslam fly corridor --fly --record flights/today",
        "edgeslam fly exit 90 --drone sim://rooms:1 --fly",
        "edgeslam fly replay flights/today",
    ),
    "sim": ("edgeslam sim", "edgeslam sim --world rooms --wind 0.5 --loss 2"),
    "export-map": (
        "edgeslam export-map runs/flight --format ply -o map.ply",
        "edgeslam export-map runs/flight --format occupancy --resolution 0.05 -o grid",
    ),
    "batch": (
        "edgeslam batch recordings/ -o out --jobs 4",
        "edgeslam batch flights.csv -o out --set orb.features=1500",
    ),
    "depth": ("edgeslam depth picture.jpg -o depths", "edgeslam depth recording/ --depth near --sigma -o depths"),
    "finetune": (
        "edgeslam finetune recordings/* --validate recordings/last -o mine",
        "edgeslam finetune runs/* --from-runs --depth near -o mine",
    ),
    "distil": ("edgeslam distil recordings/* --teacher depth_anything.onnx -o small",),
    "export": (
        "edgeslam export -o depth.onnx --int8 --calibrate recording/",
        "edgeslam export --depth mine.safetensors -o mine.onnx",
    ),
    "weights": (
        "edgeslam weights list",
        "edgeslam weights download mobilenet-nnconv5dw-skipadd",
        "edgeslam weights convert mobilenet-nnconv5dw-skipadd.pth.tar -o fastdepth.safetensors",
        "edgeslam weights inspect mine.safetensors",
    ),
    "eval": (
        "edgeslam eval runs/flight",
        "edgeslam eval runs/a orbslam.txt -g recording/ --common-frames --plots pictures",
        "edgeslam eval trajectory.txt -g mav0/mocap0/data.csv --json scores.json",
    ),
    "compare": ("edgeslam compare runs/before runs/after", "edgeslam compare runs/a orbslam.txt -g groundtruth.txt"),
    "bench": ("edgeslam bench --data recordings --seeds 3", "edgeslam bench --compare before.json after.json"),
    "judge": (
        "edgeslam judge recordings --cells all --seeds 5 -o out",
        "edgeslam judge recordings --only 'tum_*' --set orb.features=1500 -o out2 --against out",
    ),
    "ablation": ("edgeslam ablation --data recordings --seeds 2 -o out",),
}
