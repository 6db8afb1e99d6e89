# avatar, bodies, rig -> fisheye RGBA, depth, parts
rule render:
    input:
        avatar="results/4_train/{source}/{actor}",
        bodies=body_folder,
        packages=render_packages,
        model=body_model,
    output:
        directory("results/5_render/{source}/{actor}/{action}/{rig}/{shard}"),
    log:
        "logs/5_render/{source}/{actor}/{action}/{rig}/{shard}.log",
    benchmark:
        "results/benchmarks/5_render/{source}/{actor}/{action}/{rig}/{shard}.tsv"
    conda:
        "../../environment.yml"
    resources:
        mem_mb=memory_mb(3000),
        gpu=0,
    params:
        config=body_stage_params("render"),
        packages=PACKAGES,
        motion=render_motion,
        frames=sets_of_shard,
        work="results/work/5_render/{source}/{actor}/{action}/{rig}/{shard}",
    shell:
        "NUMBA_NUM_THREADS={threads} exec ntop lease -n {resources.gpu} -- ntop render"
        " --config {params.config:q} --source {wildcards.source}"
        " --actor {wildcards.actor} --action {wildcards.action} --rig {wildcards.rig}"
        " --frames {params.frames} --motion={params.motion:q} --avatar {input.avatar:q}"
        " --bodies {input.bodies:q}/bodies.parquet --packages {params.packages:q}"
        " --work {params.work:q} --out {output:q} 2> {log:q}"
