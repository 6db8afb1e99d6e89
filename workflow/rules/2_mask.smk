# frames -> person mattes and 2D keypoints
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
    conda:
        "../../environment.yml"
    threads: 2
    resources:
        mem_mb=memory_mb(3000),
    params:
        config=stage_params("mask"),
        packages=PACKAGES,
    shell:
        "exec ntop mask --config {params.config:q} --capture {input.capture:q}"
        " --packages {params.packages:q} --out {output:q} 2> {log:q}"
