# Mocks without substructure: the same steps as any other mock, then each plays the observation.
rule null_mocks:
    input:
        observation=single("observation"),
        smooth_model=single("smooth_model"),
    output:
        ensure(single("null_mocks"), non_empty=True),
    params:
        settings=settings("null_mocks"),
    log:
        results("logs/null/mocks.log"),
    benchmark:
        results("benchmarks/null/mocks.tsv")
    resources:
        mem_mb=1000,
        runtime=60,
        sample_seconds=SAMPLE_SECONDS,
    message:
        "null test: mocks without substructure"
    shell:
        "warmlens null-mocks --params {params.settings:q} --observation {input.observation:q}"
        " --smooth-model {input.smooth_model:q} --output {output:q}"
        " --sample-seconds {resources.sample_seconds} > {log:q} 2>&1"


rule null_scans:
    input:
        mocks=single("null_mocks"),
        observation=single("observation"),
        smooth_model=single("smooth_model"),
        design=single("scan_design"),
        shards=all_chunks("scan_operator"),
    output:
        ensure(single("null_scans"), non_empty=True),
    params:
        settings=settings("null_scans"),
        shards=lambda wildcards, input: repeated("shard", input.shards),
    log:
        results("logs/null/scans.log"),
    benchmark:
        results("benchmarks/null/scans.tsv")
    resources:
        mem_mb=3000,
        runtime=120,
    message:
        "null test: scans"
    shell:
        "warmlens null-scans --params {params.settings:q} --mocks {input.mocks:q}"
        " --observation {input.observation:q} --smooth-model {input.smooth_model:q}"
        " --design {input.design:q} {params.shards} --output {output:q} > {log:q} 2>&1"


rule null_summaries:
    input:
        scans=single("null_scans"),
    output:
        ensure(single("null_summaries"), non_empty=True),
    params:
        settings=settings("null_summaries"),
    log:
        results("logs/null/summaries.log"),
    benchmark:
        results("benchmarks/null/summaries.tsv")
    resources:
        mem_mb=1000,
        runtime=30,
    message:
        "null test: summaries"
    shell:
        "warmlens null-summaries --params {params.settings:q} --scans {input.scans:q}"
        " --output {output:q} > {log:q} 2>&1"
