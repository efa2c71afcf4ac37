rule deflections:
    input:
        halos=chunk("halos"),
        observation=single("observation"),
    output:
        ensure(chunk("deflections"), non_empty=True),
    params:
        settings=settings("deflections"),
    log:
        results("logs/deflections/{start}-{stop}.log"),
    benchmark:
        results("benchmarks/deflections/{start}-{stop}.tsv")
    resources:
        mem_mb=1000,
        runtime=60,
        sample_seconds=SAMPLE_SECONDS,
    message:
        "deflections: samples {wildcards.start} to {wildcards.stop}"
    shell:
        "warmlens deflections --params {params.settings:q} --halos {input.halos:q}"
        " --observation {input.observation:q} --output {output:q} --sample-seconds {resources.sample_seconds} > {log:q} 2>&1"
