rule scan_design:
    input:
        unpack(inputs("scan_design")),
    output:
        ensure(output("scan_design"), non_empty=True),
    params:
        settings=settings("scan_design"),
        inputs=input_words,
    log:
        note("logs", "scan_design"),
    benchmark:
        note("benchmarks", "scan_design")
    resources:
        mem_mb=3000,
        runtime=30,
    priority: 2
    message:
        "scan operator: what all positions share"
    shell:
        command("scan_design")


rule scan_operator:
    input:
        unpack(inputs("scan_operator")),
    output:
        ensure(output("scan_operator"), non_empty=True),
    params:
        settings=settings("scan_operator"),
        inputs=input_words,
    log:
        note("logs", "scan_operator"),
    benchmark:
        note("benchmarks", "scan_operator")
    resources:
        mem_mb=3000,
        runtime=60,
    priority: 1
    message:
        "scan operator: positions {wildcards.start} to {wildcards.stop}"
    shell:
        command("scan_operator")
