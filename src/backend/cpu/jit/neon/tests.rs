//! The encoder against GNU as 2.40.

use super::*;
use crate::backend::cpu::jit::listing::{Row, agrees, m, r};
use crate::model::Precision::F64;

/// What is behind the first `skipped` bytes, as words.
fn words(bytes: &[u8], skipped: usize) -> String {
    let word = |b: &[u8]| format!("{:08x}", u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    let words: Vec<String> = bytes[skipped..].chunks_exact(4).map(word).collect();
    words.join(" ")
}

#[test]
fn instructions() {
    let listing: &[Row<'_, Assembler>] = &[
        (
            |a| a.binary(Binary::Add, 1, 2, r(3)),
            ["fadd v1.2d, v2.2d, v3.2d", "4e63d441"],
            ["fadd v1.4s, v2.4s, v3.4s", "4e23d441"],
        ),
        (
            |a| a.binary(Binary::Sub, 8, 29, m(Base::Frame, 192)),
            [
                "ldr q31, [x0, #192]; fsub v8.2d, v29.2d, v31.2d",
                "3dc0301f 4effd7a8",
            ],
            [
                "ldr q31, [x0, #192]; fsub v8.4s, v29.4s, v31.4s",
                "3dc0301f 4ebfd7a8",
            ],
        ),
        (
            |a| a.binary(Binary::Mul, 17, 28, r(25)),
            ["fmul v17.2d, v28.2d, v25.2d", "6e79df91"],
            ["fmul v17.4s, v28.4s, v25.4s", "6e39df91"],
        ),
        (
            |a| a.binary(Binary::Div, 9, 16, m(Base::Pool, 65520)),
            [
                "ldr q31, [x1, #65520]; fdiv v9.2d, v16.2d, v31.2d",
                "3dfffc3f 6e7ffe09",
            ],
            [
                "ldr q31, [x1, #65520]; fdiv v9.4s, v16.4s, v31.4s",
                "3dfffc3f 6e3ffe09",
            ],
        ),
        (
            |a| a.binary(Binary::Div, 9, 16, m(Base::Pool, 65536)),
            [
                "add x9, x1, #16, lsl #12; ldr q31, [x9]; fdiv v9.2d, v16.2d, v31.2d",
                "91404029 3dc0013f 6e7ffe09",
            ],
            [
                "add x9, x1, #16, lsl #12; ldr q31, [x9]; fdiv v9.4s, v16.4s, v31.4s",
                "91404029 3dc0013f 6e3ffe09",
            ],
        ),
        (
            |a| a.binary(Binary::And, 20, 3, m(Base::Spill, 16)),
            [
                "ldr q31, [x3, #16]; and v20.16b, v3.16b, v31.16b",
                "3dc0047f 4e3f1c74",
            ],
            [
                "ldr q31, [x3, #16]; and v20.16b, v3.16b, v31.16b",
                "3dc0047f 4e3f1c74",
            ],
        ),
        (
            |a| a.binary(Binary::Or, 5, 27, r(9)),
            ["orr v5.16b, v27.16b, v9.16b", "4ea91f65"],
            ["orr v5.16b, v27.16b, v9.16b", "4ea91f65"],
        ),
        (
            |a| a.binary(Binary::Xor, 24, 8, r(16)),
            ["eor v24.16b, v8.16b, v16.16b", "6e301d18"],
            ["eor v24.16b, v8.16b, v16.16b", "6e301d18"],
        ),
        (
            |a| a.binary(Binary::AddBits, 12, 23, r(4)),
            ["add v12.2d, v23.2d, v4.2d", "4ee486ec"],
            ["add v12.4s, v23.4s, v4.4s", "4ea486ec"],
        ),
        (
            |a| a.binary(Binary::Compare(Comparison::Less), 3, 20, r(5)),
            ["fcmgt v3.2d, v5.2d, v20.2d", "6ef4e4a3"],
            ["fcmgt v3.4s, v5.4s, v20.4s", "6eb4e4a3"],
        ),
        (
            |a| a.binary(Binary::Compare(Comparison::Equal), 2, 7, r(11)),
            ["fcmeq v2.2d, v7.2d, v11.2d", "4e6be4e2"],
            ["fcmeq v2.4s, v7.4s, v11.4s", "4e2be4e2"],
        ),
        (
            |a| a.binary(Binary::Compare(Comparison::Unordered), 6, 2, r(19)),
            [
                "fcmeq v30.2d, v2.2d, v2.2d; fcmeq v6.2d, v19.2d, v19.2d; and v6.16b, v6.16b, v30.16b; not v6.16b, v6.16b",
                "4e62e45e 4e73e666 4e3e1cc6 6e2058c6",
            ],
            [
                "fcmeq v30.4s, v2.4s, v2.4s; fcmeq v6.4s, v19.4s, v19.4s; and v6.16b, v6.16b, v30.16b; not v6.16b, v6.16b",
                "4e22e45e 4e33e666 4e3e1cc6 6e2058c6",
            ],
        ),
        (
            |a| a.fused(Fused::MulAdd, Form::F231, 1, 17, r(26)),
            ["fmla v1.2d, v17.2d, v26.2d", "4e7ace21"],
            ["fmla v1.4s, v17.4s, v26.4s", "4e3ace21"],
        ),
        (
            |a| a.fused(Fused::MulSub, Form::F231, 28, 2, m(Base::Pool, 256)),
            [
                "ldr q31, [x1, #256]; fneg v28.2d, v28.2d; fmla v28.2d, v2.2d, v31.2d",
                "3dc0403f 6ee0fb9c 4e7fcc5c",
            ],
            [
                "ldr q31, [x1, #256]; fneg v28.4s, v28.4s; fmla v28.4s, v2.4s, v31.4s",
                "3dc0403f 6ea0fb9c 4e3fcc5c",
            ],
        ),
        (
            |a| a.fused(Fused::NegMulAdd, Form::F231, 11, 9, r(7)),
            ["fmls v11.2d, v9.2d, v7.2d", "4ee7cd2b"],
            ["fmls v11.4s, v9.4s, v7.4s", "4ea7cd2b"],
        ),
        (
            |a| a.sqrt(29, r(0)),
            ["fsqrt v29.2d, v0.2d", "6ee1f81d"],
            ["fsqrt v29.4s, v0.4s", "6ea1f81d"],
        ),
        (
            |a| a.shift(true, 22, 9, 23),
            ["shl v22.2d, v9.2d, #23", "4f575536"],
            ["shl v22.4s, v9.4s, #23", "4f375536"],
        ),
        (
            |a| a.shift(false, 6, 27, 11),
            ["ushr v6.2d, v27.2d, #11", "6f750766"],
            ["ushr v6.4s, v27.4s, #11", "6f350766"],
        ),
        (
            |a| a.blend(5, 14, r(8), 3),
            [
                "cmlt v30.2d, v14.2d, #0; mov v5.16b, v3.16b; bit v5.16b, v8.16b, v30.16b",
                "4ee0a9de 4ea31c65 6ebe1d05",
            ],
            [
                "cmlt v30.4s, v14.4s, #0; mov v5.16b, v3.16b; bit v5.16b, v8.16b, v30.16b",
                "4ea0a9de 4ea31c65 6ebe1d05",
            ],
        ),
        (
            |a| a.blend(5, 14, m(Base::Frame, 32), 5),
            [
                "ldr q31, [x0, #32]; cmlt v30.2d, v14.2d, #0; bit v5.16b, v31.16b, v30.16b",
                "3dc0081f 4ee0a9de 6ebe1fe5",
            ],
            [
                "ldr q31, [x0, #32]; cmlt v30.4s, v14.4s, #0; bit v5.16b, v31.16b, v30.16b",
                "3dc0081f 4ea0a9de 6ebe1fe5",
            ],
        ),
        (
            |a| a.blend(5, 5, r(5), 3),
            [
                "cmlt v30.2d, v5.2d, #0; bif v5.16b, v3.16b, v30.16b",
                "4ee0a8be 6efe1c65",
            ],
            [
                "cmlt v30.4s, v5.4s, #0; bif v5.16b, v3.16b, v30.16b",
                "4ea0a8be 6efe1c65",
            ],
        ),
        (
            |a| a.copy(3, r(29)),
            ["mov v3.16b, v29.16b", "4ebd1fa3"],
            ["mov v3.16b, v29.16b", "4ebd1fa3"],
        ),
        (
            |a| a.copy(10, m(Base::Spill, 64)),
            ["ldr q10, [x3, #64]", "3dc0106a"],
            ["ldr q10, [x3, #64]", "3dc0106a"],
        ),
        (
            |a| a.store(28, Base::Frame, 1193040),
            [
                "add x9, x0, #288, lsl #12; str q28, [x9, #13392]",
                "91448009 3d8d153c",
            ],
            [
                "add x9, x0, #288, lsl #12; str q28, [x9, #13392]",
                "91448009 3d8d153c",
            ],
        ),
    ];
    agrees(listing, |precision, emit| {
        let mut assembler = Set::Neon.encoder(precision);
        emit(&mut assembler);
        words(&assembler.bytes, assembler.prologue)
    });
}

/// One addition, repeated.
#[test]
fn a_loop() {
    let mut assembler = Assembler::new(F64);
    assembler.binary(Binary::Add, 1, 2, r(3));
    let want = [
        "6dbc27e8", "6d012fea", "6d0237ec", "6d033fee", "4e63d441", "91008000", "f1000442",
        "54000040", "17fffffc", "6d412fea", "6d4237ec", "6d433fee", "6cc427e8", "d65f03c0",
    ];
    assert_eq!(words(&assembler.repeat(32), 0), want.join(" "));
}
