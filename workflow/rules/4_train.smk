# frames, mattes, bodies -> one avatar per actor
rule train:
    input:
        capture=capture_folder,
        mattes=matte_folder,
        bodies=body_folder,
        model=body_model,
        perceptual=perceptual_package,
    output:
        directory("results/4_train/{source}/{actor}"),
    log:
        "logs/4_train/{source}/{actor}.log",
    benchmark:
        "results/benchmarks/4_train/{source}/{actor}.tsv"
    conda:
        "../../environment.yml"
    threads: 2
    resources:
        mem_mb=memory_mb(6000),
        gpu=0,
    params:
        config=body_stage_params("train"),
        work="results/work/4_train/{source}/{actor}",
    shell:
        "NUMBA_NUM_THREADS={threads} exec ntop lease -n {resources.gpu} -- ntop train"
        " --config {params.config:q} --capture {input.capture:q}"
        " --cameras {input.bodies:q}/cameras.parquet --masks {input.mattes:q}/masks.parquet"
        " --bodies {input.bodies:q}/bodies.parquet --work {params.work:q}"
        " --out {output:q} 2> {log:q}"
