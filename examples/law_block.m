function u = law_block(x) %#codegen
% LAW_BLOCK  A fitted law's C header in a MATLAB Function block of Simulink, or in generated code.
%     law.save('law.h')                     (Python; or `costate fit`, `costate export`)
% gives law.h, with a function NAME_u(x, u), NAME being the law's: here `small`, of two states and one control.
% In the block's Custom Code: include "law.h". In MATLAB alone, and in Octave, use the FMU, or fitted weights.
u = zeros(1, 1);
x = double(x);
coder.cinclude('law.h');
coder.ceval('small_u', coder.rref(x), coder.wref(u));
end
