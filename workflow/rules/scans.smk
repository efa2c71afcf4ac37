rule observed_scan:
    input:
        observation=single("observation"),
        smooth_model=single("smooth_model"),
        design=single("scan_design"),
        shards=all_chunks("scan_operator"),
    output:
        ensure(single("observed_scan"), non_empty=True),
    params:
        settings=settings("observed_scan"),
        shards=lambda wildcards, input: repeated("shard", input.shards),
    log:
        results("logs/observed_scan.log"),
    benchmark:
        results("benchmarks/observed_scan.tsv")
    resources:
        mem_mb=3000,
        runtime=60,
    message:
        "scan of the observation"
    shell:
        "warmlens observed-scan --params {params.settings:q} --observation {input.observation:q}"
        " --smooth-model {input.smooth_model:q} --design {input.design:q} {params.shards}"
        " --output {output:q} > {log:q} 2>&1"


rule scans:
    input:
        mocks=chunk("mocks"),
        observation=single("observation"),
        smooth_model=single("smooth_model"),
        design=single("scan_design"),
        shards=all_chunks("scan_operator"),
    output:
        ensure(chunk("scans"), non_empty=True),
    params:
        settings=settings("scans"),
        shards=lambda wildcards, input: repeated("shard", input.shards),
    log:
        results("logs/scans/{start}-{stop}.log"),
    benchmark:
        results("benchmarks/scans/{start}-{stop}.tsv")
    resources:
        mem_mb=3000,
        runtime=120,
    message:
        "scans: samples {wildcards.start} to {wildcards.stop}"
    shell:
        "warmlens scans --params {params.settings:q} --mocks {input.mocks:q}"
        " --observation {input.observation:q} --smooth-model {input.smooth_model:q}"
        " --design {input.design:q} {params.shards} --output {output:q} > {log:q} 2>&1"
