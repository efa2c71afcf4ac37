rule observed_scan:
    input:
        unpack(inputs("observed_scan")),
    output:
        ensure(output("observed_scan"), non_empty=True),
    params:
        settings=settings("observed_scan"),
        inputs=input_words,
    log:
        note("logs", "observed_scan"),
    benchmark:
        note("benchmarks", "observed_scan")
    resources:
        mem_mb=3000,
        runtime=60,
    message:
        "scan of the observation"
    shell:
        command("observed_scan")


rule scans:
    input:
        unpack(inputs("scans")),
    output:
        ensure(output("scans"), non_empty=True),
    params:
        settings=settings("scans"),
        inputs=input_words,
    log:
        note("logs", "scans"),
    benchmark:
        note("benchmarks", "scans")
    resources:
        mem_mb=3000,
        runtime=120,
    message:
        "scans: samples {wildcards.start} to {wildcards.stop}"
    shell:
        command("scans")
