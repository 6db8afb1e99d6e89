# dataset, captures, avatars -> metrics and report
rule evaluate:
    input:
        dataset="results/7_assemble/{dataset}",
        captures=actor_folders(capture_folder),
        mattes=actor_folders(matte_folder),
        bodies=actor_folders(body_folder),
        avatars=[f"results/4_train/{actor.source}/{actor.actor}" for actor in ACTORS],
        references=reference_mask_files,
        actors=CONFIG.actors,
    output:
        report(
            directory("results/8_evaluate/{dataset}"),
            patterns=["exhibits/{topic,[a-z]+}-{words}.{kind,jpg|svg|html}"],
            category=exhibit_category,
            subcategory=exhibit_subcategory,
            labels=exhibit_labels,
            caption="../report/exhibit.rst",
        ),
    log:
        "logs/8_evaluate/{dataset}.log",
    benchmark:
        "results/benchmarks/8_evaluate/{dataset}.tsv"
    conda:
        "../../environment.yml"
    threads: 2
    resources:
        mem_mb=memory_mb(4000),
    params:
        config=evaluate_params,
        benchmarks="results/benchmarks",
    shell:
        "NUMBA_NUM_THREADS={threads} exec ntop evaluate --config {params.config:q} --dataset {input.dataset:q}"
        " --actors {input.actors:q} --captures results/1_capture --masks results/2_mask"
        " --fits results/3_fit --avatars results/4_train --benchmarks {params.benchmarks:q}"
        " --out {output:q} 2> {log:q}"
