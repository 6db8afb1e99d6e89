# all shards -> manifest, COCO and SMPL files, sets, card
rule assemble:
    input:
        renders=[f"results/5_render/{shard}" for shard in SHARDS],
        annotations=[f"results/6_annotate/{shard}.parquet" for shard in SHARDS],
        sequences=CONFIG.sequences,
    output:
        directory("results/7_assemble/{dataset}"),
    log:
        "logs/7_assemble/{dataset}.log",
    benchmark:
        "results/benchmarks/7_assemble/{dataset}.tsv"
    conda:
        "../../environment.yml"
    resources:
        mem_mb=memory_mb(2000),
    params:
        config=assemble_params,
    shell:
        "exec ntop assemble --config {params.config:q} --sequences {input.sequences:q}"
        " --renders results/5_render --annotations results/6_annotate"
        " --out {output:q} 2> {log:q}"
