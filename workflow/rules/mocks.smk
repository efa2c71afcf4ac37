rule mocks:
    input:
        deflections=chunk("deflections"),
        observation=single("observation"),
        smooth_model=single("smooth_model"),
    output:
        ensure(chunk("mocks"), non_empty=True),
    params:
        settings=settings("mocks"),
    log:
        results("logs/mocks/{start}-{stop}.log"),
    benchmark:
        results("benchmarks/mocks/{start}-{stop}.tsv")
    resources:
        mem_mb=1000,
        runtime=60,
        sample_seconds=SAMPLE_SECONDS,
    message:
        "mocks: samples {wildcards.start} to {wildcards.stop}"
    shell:
        "warmlens mocks --params {params.settings:q} --deflections {input.deflections:q}"
        " --observation {input.observation:q} --smooth-model {input.smooth_model:q}"
        " --output {output:q} --sample-seconds {resources.sample_seconds} > {log:q} 2>&1"
