//! The encoder against GNU as 2.40 (Intel syntax).

use super::*;
use crate::backend::cpu::jit::listing::{self, Row, m, r};

fn agrees(set: Set, listing: &[Row<'_, Assembler>]) {
    listing::agrees(listing, |precision, emit| {
        let mut assembler = set.encoder(precision);
        emit(&mut assembler);
        let hex: Vec<String> = (assembler.bytes.iter())
            .map(|b| format!("{b:02x}"))
            .collect();
        hex.join(" ")
    });
}

#[test]
fn avx512() {
    agrees(
        Set::Avx512,
        &[
            (
                |a| a.binary(Binary::Add, 1, 2, r(3)),
                ["vaddpd zmm1, zmm2, zmm3", "62 f1 ed 48 58 cb"],
                ["vaddps zmm1, zmm2, zmm3", "62 f1 6c 48 58 cb"],
            ),
            (
                |a| a.binary(Binary::Mul, 17, 30, r(25)),
                ["vmulpd zmm17, zmm30, zmm25", "62 81 8d 40 59 c9"],
                ["vmulps zmm17, zmm30, zmm25", "62 81 0c 40 59 c9"],
            ),
            (
                |a| a.binary(Binary::Sub, 8, 15, m(Base::Frame, 192)),
                ["vsubpd zmm8, zmm15, [rdi+192]", "62 71 85 48 5c 47 03"],
                ["vsubps zmm8, zmm15, [rdi+192]", "62 71 04 48 5c 47 03"],
            ),
            (
                |a| a.binary(Binary::Div, 9, 16, m(Base::Pool, 8128)),
                ["vdivpd zmm9, zmm16, [rsi+8128]", "62 71 fd 40 5e 4e 7f"],
                ["vdivps zmm9, zmm16, [rsi+8128]", "62 71 7c 40 5e 4e 7f"],
            ),
            (
                |a| a.binary(Binary::Div, 9, 16, m(Base::Pool, 8192)),
                [
                    "vdivpd zmm9, zmm16, [rsi+8192]",
                    "62 71 fd 40 5e 8e 00 20 00 00",
                ],
                [
                    "vdivps zmm9, zmm16, [rsi+8192]",
                    "62 71 7c 40 5e 8e 00 20 00 00",
                ],
            ),
            (
                |a| a.binary(Binary::And, 20, 3, m(Base::Spill, 72)),
                [
                    "vandpd zmm20, zmm3, [rcx+72]",
                    "62 e1 e5 48 54 a1 48 00 00 00",
                ],
                [
                    "vandps zmm20, zmm3, [rcx+72]",
                    "62 e1 64 48 54 a1 48 00 00 00",
                ],
            ),
            (
                |a| a.binary(Binary::Or, 5, 31, r(9)),
                ["vorpd zmm5, zmm31, zmm9", "62 d1 85 40 56 e9"],
                ["vorps zmm5, zmm31, zmm9", "62 d1 04 40 56 e9"],
            ),
            (
                |a| a.binary(Binary::Xor, 24, 8, r(16)),
                ["vxorpd zmm24, zmm8, zmm16", "62 21 bd 48 57 c0"],
                ["vxorps zmm24, zmm8, zmm16", "62 21 3c 48 57 c0"],
            ),
            (
                |a| a.binary(Binary::AddBits, 12, 23, r(4)),
                ["vpaddq zmm12, zmm23, zmm4", "62 71 c5 40 d4 e4"],
                ["vpaddd zmm12, zmm23, zmm4", "62 71 45 40 fe e4"],
            ),
            (
                |a| a.compare(Comparison::Less, 3, 20, r(5)),
                ["vcmppd k3, zmm20, zmm5, 0x11", "62 f1 dd 40 c2 dd 11"],
                ["vcmpps k3, zmm20, zmm5, 0x11", "62 f1 5c 40 c2 dd 11"],
            ),
            (
                |a| a.compare(Comparison::Unordered, 6, 2, m(Base::Frame, 64)),
                ["vcmppd k6, zmm2, [rdi+64], 3", "62 f1 ed 48 c2 77 01 03"],
                ["vcmpps k6, zmm2, [rdi+64], 3", "62 f1 6c 48 c2 77 01 03"],
            ),
            (
                |a| a.spread(19, 7),
                ["vpmovm2q zmm19, k7", "62 e2 fe 48 38 df"],
                ["vpmovm2d zmm19, k7", "62 e2 7e 48 38 df"],
            ),
            (
                |a| a.choose(4, 2, r(12), 21),
                ["vblendmpd zmm4{k2}, zmm21, zmm12", "62 d2 d5 42 65 e4"],
                ["vblendmps zmm4{k2}, zmm21, zmm12", "62 d2 55 42 65 e4"],
            ),
            (
                |a| a.choose(28, 5, m(Base::Spill, 128), 1),
                [
                    "vblendmpd zmm28{k5}, zmm1, [rcx+128]",
                    "62 62 f5 4d 65 61 02",
                ],
                [
                    "vblendmps zmm28{k5}, zmm1, [rcx+128]",
                    "62 62 75 4d 65 61 02",
                ],
            ),
            (
                |a| a.fused(Fused::MulAdd, Form::F132, 1, 17, r(26)),
                ["vfmadd132pd zmm1, zmm17, zmm26", "62 92 f5 40 98 ca"],
                ["vfmadd132ps zmm1, zmm17, zmm26", "62 92 75 40 98 ca"],
            ),
            (
                |a| a.fused(Fused::MulSub, Form::F213, 30, 2, m(Base::Pool, 256)),
                ["vfmsub213pd zmm30, zmm2, [rsi+256]", "62 62 ed 48 aa 76 04"],
                ["vfmsub213ps zmm30, zmm2, [rsi+256]", "62 62 6d 48 aa 76 04"],
            ),
            (
                |a| a.fused(Fused::NegMulAdd, Form::F231, 11, 9, r(7)),
                ["vfnmadd231pd zmm11, zmm9, zmm7", "62 72 b5 48 bc df"],
                ["vfnmadd231ps zmm11, zmm9, zmm7", "62 72 35 48 bc df"],
            ),
            (
                |a| a.sqrt(31, r(0)),
                ["vsqrtpd zmm31, zmm0", "62 61 fd 48 51 f8"],
                ["vsqrtps zmm31, zmm0", "62 61 7c 48 51 f8"],
            ),
            (
                |a| a.shift(true, 22, 9, 23),
                ["vpsllq zmm22, zmm9, 23", "62 d1 cd 40 73 f1 17"],
                ["vpslld zmm22, zmm9, 23", "62 d1 4d 40 72 f1 17"],
            ),
            (
                |a| a.shift(false, 6, 27, 11),
                ["vpsrlq zmm6, zmm27, 11", "62 91 cd 48 73 d3 0b"],
                ["vpsrld zmm6, zmm27, 11", "62 91 4d 48 72 d3 0b"],
            ),
            (
                |a| a.copy(3, r(29)),
                ["vmovaps zmm3, zmm29", "62 91 7c 48 28 dd"],
                ["vmovaps zmm3, zmm29", "62 91 7c 48 28 dd"],
            ),
            (
                |a| a.copy(10, m(Base::Spill, 64)),
                ["vmovups zmm10, [rcx+64]", "62 71 7c 48 10 51 01"],
                ["vmovups zmm10, [rcx+64]", "62 71 7c 48 10 51 01"],
            ),
            (
                |a| a.store(28, Base::Frame, 74565),
                [
                    "vmovups [rdi+74565], zmm28",
                    "62 61 7c 48 11 a7 45 23 01 00",
                ],
                [
                    "vmovups [rdi+74565], zmm28",
                    "62 61 7c 48 11 a7 45 23 01 00",
                ],
            ),
        ],
    );
}

#[test]
fn avx2() {
    agrees(
        Set::Avx2,
        &[
            (
                |a| a.binary(Binary::Add, 1, 2, r(3)),
                ["vaddpd ymm1, ymm2, ymm3", "c5 ed 58 cb"],
                ["vaddps ymm1, ymm2, ymm3", "c5 ec 58 cb"],
            ),
            (
                |a| a.binary(Binary::Mul, 9, 14, r(12)),
                ["vmulpd ymm9, ymm14, ymm12", "c4 41 0d 59 cc"],
                ["vmulps ymm9, ymm14, ymm12", "c4 41 0c 59 cc"],
            ),
            (
                |a| a.binary(Binary::Sub, 8, 15, m(Base::Frame, 96)),
                ["vsubpd ymm8, ymm15, [rdi+96]", "c5 05 5c 47 60"],
                ["vsubps ymm8, ymm15, [rdi+96]", "c5 04 5c 47 60"],
            ),
            (
                |a| a.binary(Binary::Div, 9, 6, m(Base::Pool, 128)),
                ["vdivpd ymm9, ymm6, [rsi+128]", "c5 4d 5e 8e 80 00 00 00"],
                ["vdivps ymm9, ymm6, [rsi+128]", "c5 4c 5e 8e 80 00 00 00"],
            ),
            (
                |a| a.binary(Binary::Compare(Comparison::Equal), 2, 7, r(11)),
                ["vcmppd ymm2, ymm7, ymm11, 0", "c4 c1 45 c2 d3 00"],
                ["vcmpps ymm2, ymm7, ymm11, 0", "c4 c1 44 c2 d3 00"],
            ),
            (
                |a| a.binary(Binary::AddBits, 12, 3, r(4)),
                ["vpaddq ymm12, ymm3, ymm4", "c5 65 d4 e4"],
                ["vpaddd ymm12, ymm3, ymm4", "c5 65 fe e4"],
            ),
            (
                |a| a.fused(Fused::MulAdd, Form::F132, 1, 13, r(10)),
                ["vfmadd132pd ymm1, ymm13, ymm10", "c4 c2 95 98 ca"],
                ["vfmadd132ps ymm1, ymm13, ymm10", "c4 c2 15 98 ca"],
            ),
            (
                |a| a.fused(Fused::NegMulAdd, Form::F231, 11, 9, m(Base::Spill, 32)),
                ["vfnmadd231pd ymm11, ymm9, [rcx+32]", "c4 62 b5 bc 59 20"],
                ["vfnmadd231ps ymm11, ymm9, [rcx+32]", "c4 62 35 bc 59 20"],
            ),
            (
                |a| a.sqrt(15, r(0)),
                ["vsqrtpd ymm15, ymm0", "c5 7d 51 f8"],
                ["vsqrtps ymm15, ymm0", "c5 7c 51 f8"],
            ),
            (
                |a| a.shift(true, 6, 9, 23),
                ["vpsllq ymm6, ymm9, 23", "c4 c1 4d 73 f1 17"],
                ["vpslld ymm6, ymm9, 23", "c4 c1 4d 72 f1 17"],
            ),
            (
                |a| a.blend(5, 14, r(8), 3),
                ["vblendvpd ymm5, ymm3, ymm8, ymm14", "c4 c3 65 4b e8 e0"],
                ["vblendvps ymm5, ymm3, ymm8, ymm14", "c4 c3 65 4a e8 e0"],
            ),
            (
                |a| a.copy(13, r(3)),
                ["vmovaps ymm13, ymm3", "c5 7c 28 eb"],
                ["vmovaps ymm13, ymm3", "c5 7c 28 eb"],
            ),
            (
                |a| a.store(12, Base::Frame, 74565),
                ["vmovups [rdi+74565], ymm12", "c5 7c 11 a7 45 23 01 00"],
                ["vmovups [rdi+74565], ymm12", "c5 7c 11 a7 45 23 01 00"],
            ),
        ],
    );
}
