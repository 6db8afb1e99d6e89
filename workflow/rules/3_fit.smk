# keypoints -> refined cameras, one body pose per frame, shared betas per actor
rule fit:
    input:
        capture=capture_folder,
        masks=mask_folder,
    output:
        directory("results/3_fit/{source}/{actor}"),
    log:
        "logs/3_fit/{source}/{actor}.log",
    benchmark:
        "results/benchmarks/3_fit/{source}/{actor}.tsv"
    conda:
        "../../environment.yml"
    threads: 2
    resources:
        mem_mb=4000,
    params:
        config=stage_params("fit"),
    shell:
        "exec ntop fit --config {params.config:q} --capture {input.capture:q}"
        " --masks {input.masks:q} --out {output:q} 2> {log:q}"
