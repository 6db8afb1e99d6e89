# source footage -> frames and cameras in our conventions
rule capture:
    input:
        packages=capture_packages,
    output:
        directory("results/1_capture/{source}/{actor}"),
    log:
        "logs/1_capture/{source}/{actor}.log",
    benchmark:
        "results/benchmarks/1_capture/{source}/{actor}.tsv"
    conda:
        "../../environment.yml"
    resources:
        mem_mb=memory_mb(2000),
    params:
        config=capture_params,
        packages=PACKAGES,
    shell:
        "exec ntop capture --config {params.config:q} --source {wildcards.source}"
        " --actor {wildcards.actor} --packages {params.packages:q} --out {output:q} 2> {log:q}"
