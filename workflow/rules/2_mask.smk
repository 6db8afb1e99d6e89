# frames -> person mattes and 2D keypoints
def mask_packages(wildcards):
    section = stage_section(CONFIG, "mask", source=wildcards.source)
    needs_network = section.get("method", "mediapipe") == "mediapipe" or not given(
        wildcards, "keypoints2d"
    )
    return package_folders(["mediapipe"] if needs_network else [])


rule mask:
    input:
        capture=capture_folder,
        packages=mask_packages,
    output:
        directory("results/2_mask/{source}/{actor}"),
    log:
        "logs/2_mask/{source}/{actor}.log",
    benchmark:
        "results/benchmarks/2_mask/{source}/{actor}.tsv"
    threads: 2
    resources:
        mem_mb=3000,
    params:
        config=stage_params("mask"),
        packages=PACKAGES,
    shell:
        "ntop mask --config {params.config:q} --capture {input.capture:q}"
        " --packages {params.packages:q} --out {output:q} 2> {log:q}"
