rule halos:
    input:
        unpack(inputs("halos")),
    output:
        ensure(output("halos"), non_empty=True),
    params:
        settings=settings("halos"),
    log:
        note("logs", "halos"),
    benchmark:
        note("benchmarks", "halos")
    resources:
        mem_mb=1000,
        runtime=60,
        sample_seconds=SAMPLE_SECONDS,
    message:
        "halos: samples {wildcards.start} to {wildcards.stop}"
    shell:
        command("halos", TIMED)
