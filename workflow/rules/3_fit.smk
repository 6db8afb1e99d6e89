# keypoints -> refined cameras, one body pose per frame, shared betas per actor
rule fit:
    input:
        capture=capture_folder,
        keypoints=keypoint_folder,
        mattes=matte_folder,
        model=body_model,
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
        mem_mb=memory_mb(4000),
    params:
        config=body_stage_params("fit"),
    shell:
        "exec ntop fit --config {params.config:q} --capture {input.capture:q}"
        " --keypoints {input.keypoints:q}/keypoints2d.parquet"
        " --masks {input.mattes:q}/masks.parquet --out {output:q} 2> {log:q}"
