# renders -> 2D and 3D keypoints, visibility, boxes, areas, RLE
rule annotate:
    input:
        renders="results/5_render/{source}/{actor}/{action}/{rig}/{shard}",
    output:
        "results/6_annotate/{source}/{actor}/{action}/{rig}/{shard}.parquet",
    log:
        "logs/6_annotate/{source}/{actor}/{action}/{rig}/{shard}.log",
    benchmark:
        "results/benchmarks/6_annotate/{source}/{actor}/{action}/{rig}/{shard}.tsv"
    conda:
        "../../environment.yml"
    resources:
        mem_mb=memory_mb(1000),
    params:
        config=stage_params("annotate"),
    shell:
        "exec ntop annotate --config {params.config:q} --renders {input.renders:q}"
        " --out {output:q} 2> {log:q}"


# all shards of one actor: the target for running a campaign in slices
rule actor:
    input:
        actor_shards,
    output:
        touch("results/6_annotate/{source}/{actor}/done"),
