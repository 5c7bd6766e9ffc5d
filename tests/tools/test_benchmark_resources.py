# SPDX-License-Identifier: Apache-2.0
"""benchmark.py resources: what is read from listings, and what is said without the tools."""

import json

import benchmark
from benchmarking.cubins import lanes, resources, sass
from benchmarking.record import Check, Record, Section
from benchmarking.tables import markdown

# Two rounds' worth of nothing, then a loop: a test, a blend that a branch leaves out, a rare call.
LISTING = """
		Function : _toy_0123abcd_cuda_kernel_forward
	.headerflags	@"EF_CUDA_SM90"
        /*0000*/                   S2R R0, SR_TID.X ;            /* 0x0 */
        /*0010*/                   MOV R9, RZ ;                  /* 0x0 */
        /*0020*/                   LDS.128 R4, [R9] ;            /* 0x0 */
        /*0030*/                   LEA R8, R0, R9, 0x2 ;         /* 0x0 */
        /*0040*/                   FSETP.GE.AND P0, PT, R4, -5.541263580322265625, PT ;
        /*0050*/              @!P0 BRA 0xa0 ;                    /* 0x0 */
        /*0060*/                   MUFU.EX2 R5, R4 ;             /* 0x0 */
        /*0070*/               @P1 BRA 0xe0 ;                    /* 0x0 */
        /*0080*/                   STS [R8], R5 ;                /* 0x0 */
        /*0090*/                   FADD R6, R5, R6 ;             /* 0x0 */
        /*00a0*/                   IADD3 R9, R9, 0x10, RZ ;      /* 0x0 */
        /*00b0*/                   ISETP.NE.AND P0, PT, R9, R7, PT ;
        /*00c0*/               @P0 BRA 0x20 ;                    /* 0x0 */
        /*00d0*/                   EXIT ;                        /* 0x0 */
        /*00e0*/                   CALL.REL.NOINC 0x200 ;        /* 0x0 */
        /*00f0*/                   BRA 0x80 ;                    /* 0x0 */
"""


def listing():
    ((name, code),) = sass.parse(LISTING).items()
    assert name == "_toy_0123abcd_cuda_kernel_forward" and len(code) == 16
    return sass.blocks_of(code)


def test_a_loop_and_the_ways_through_it():
    blocks = listing()
    (loop,) = sass.loops_of(blocks)
    assert blocks[loop.head].code[0].address == 0x20
    marks = {loop.head: 1}
    blend = {k for k in loop.body if blocks[k].code[0].name == "MUFU.EX2"}
    call = {k for k in loop.body if blocks[k].code[0].operation == "CALL"}
    skipped = sass.way_through(blocks, loop, marks, without=blend, longest=False)
    blended = sass.way_through(blocks, loop, marks, without=call, longest=True)
    whole = sass.way_through(blocks, loop, marks, without=set(), longest=True)
    assert skipped and blended and whole
    assert (skipped.length, blended.length, whole.length) == (7, 11, 13)


def test_code_that_nothing_leads_to_hides_no_loop():
    """Where lanes have come together, BRA.CONV jumps over a call that brings them together."""
    text = """Function : some
        /*0000*/  MOV R0, RZ ;
        /*0010*/  IADD3 R0, R0, 0x1, RZ ;
        /*0020*/  BRA.DIV ~URZ, 0x90 ;
        /*0030*/  BRA.CONV ~URZ, 0x50 ;
        /*0040*/  CALL.REL.NOINC 0x200 ;
        /*0050*/  ISETP.NE.AND P0, PT, R0, R7, PT ;
        /*0060*/  @P0 BRA 0x10 ;
        /*0070*/  EXIT ;
        /*0090*/  BRA 0x30 ;
"""
    ((_, code),) = sass.parse(text).items()
    blocks = sass.blocks_of(code)
    (loop,) = sass.loops_of(blocks)
    way = sass.way_through(blocks, loop, {loop.head: 1}, without=set(), longest=True)
    assert way is not None and way.length == 5, "neither aside nor through the call"


def test_a_load_of_one_place_and_a_store_of_32():
    assert lanes.wavefronts(listing()) == {0x20: 1, 0x80: 1}


def places(code: str) -> list[int]:
    """Wavefronts of instructions, the thread's index being in R0."""
    lines = ["S2R R0, SR_TID.X", *code.strip().splitlines(), "EXIT"]
    text = "".join(f"        /*{16 * k:04x}*/  {line.strip()} ;\n" for k, line in enumerate(lines))
    ((_, found),) = sass.parse(f"Function : some\n{text}").items()
    return list(lanes.wavefronts(sass.blocks_of(found)).values())


def test_places_follow_from_bits_of_the_index():
    assert places("LEA R1, R0, UR4, 0x4 \n LDS.128 R4, [R1]") == [4], "32 quads are 512 bytes"
    assert places("SHF.R.U32.HI R1, RZ, 0x5, R0 \n LDS R2, [R1]") == [1], "the same in a warp"
    assert places("LOP3.LUT R1, R0, 0x10, RZ, 0xc0, !PT \n LDS.128 R4, [R1]") == [1], "two quads"
    assert places("LOP3.LUT R1, R0, 0x1f, RZ, 0xfc, !PT \n LDS.128 R4, [R1]") == [1], "all bits are set"
    assert places("LOP3.LUT R1, R0, 0xf, RZ, 0xc0, !PT \n IMAD R1, R1, 0x90, RZ \n LDS.128 R4, [R1]") == [2]
    assert places("LDS R1, [R0] \n MOV R1, R9 \n LDS.64 R2, [R1+0x10]") == [1, 1], "written anew"
    assert places("LDG.E R1, [R0.64] \n LDS.64 R2, [R1]") == [2], "loaded from places that differ"


def test_a_composite_s_row():
    (row,) = resources._splat_rows(LISTING)
    assert row == {
        "kernel": "toy", "skipped": 7.0, "blended": 11.0, "16-byte loads": 1,
        "wavefronts": 8 * 16 * 2,
    }  # fmt: skip


def test_usage_is_read_with_shared_memory_of_both_kinds():
    usage = """
 Function composite_cuda_4_0123abcd_cuda_kernel_forward:
  REG:56 STACK:8 SHARED:2096 LOCAL:0 CONSTANT[0]:1072 TEXTURE:0 SURFACE:0 SAMPLER:0
"""
    shared = {"composite_cuda_4_0123abcd_cuda_kernel_forward_smem_bytes": 90000}
    (row,) = resources._usage("raster.some", usage, shared, 90, 256)
    assert row["kernel"] == "composite_cuda_4" and (row["registers"], row["stack B"]) == (56, 8)
    assert row["shared B"] == 92096 and row["blocks"] == 2, "the memory decides"
    (row,) = resources._usage("raster.some", usage, {}, 90, 64)
    assert row["blocks"] == 18, "registers decide"


def test_without_the_tools_the_remedy_is_said(monkeypatch, capsys):
    monkeypatch.setattr(resources.shutil, "which", lambda *_, **__: None)
    assert benchmark.main(["resources"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("benchmark: resources: no cuobjdump here; pip install nvidia-cuda-cuobjdump")


def test_the_page_has_checks_and_tables():
    machine = {"device": "sm_90", "versions": {"warp-lang": "1"}, "commit": "abc", "date": "now"}
    record = Record("resources", machine, {}, [Check("a", 3.0, "<=", 2.0, "ms")])
    record.sections.append(Section("kernels", [{"kernel": "x", "registers": 32}], "as compiled"))
    page = markdown(record)
    assert "| a | 3 | ms | <= 2 | no |" in page and "| x | 32 |" in page and "As compiled." in page
    assert json.dumps(page)
