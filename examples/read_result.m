function read_result(file)
% READ_RESULT  Reads a result file in MATLAB or Octave: u at a state, and checks; an error where one fails.
%     matlab -batch "addpath examples; read_result('out/pendulum.h5')"
%     octave-cli --path examples --eval "read_result('out/pendulum.h5')"
% The scene needs [shoot_out], [homotopy] and a [map] over two states or more. Result files are HDF5 and netCDF-4 alike;
% ncread is in MATLAB and in Octave's package netcdf (octave-netcdf), which reads numbers, not the names of controls.
if exist('OCTAVE_VERSION', 'builtin'), pkg('load', 'netcdf'); import_netcdf; end
ncid = netcdf.open(file, 'NC_NOWRITE');
map = netcdf.inqNcid(ncid, 'map');
[~, ~, dims] = netcdf.inqVar(map, netcdf.inqVarID(map, 'V'));
n = numel(dims);
for k = 1:n                                             % the map's axes are named like the states
    names{k} = netcdf.inqDim(map, dims(n + 1 - k));
    nodes{k} = ncread(file, ['/map/' names{k}]);
end
netcdf.close(ncid);
[t, x, p, V, H] = take(file, 'trajectories', {'t', 'x', 'p', 'V', 'H'}, [2 3 3 2 2]);  % (trajectory, sample, state)
[x0, u0] = take(file, 'points', {'x0', 'u'}, [2 2]);                                   % (point, state or control)
[value, sheet, costate, u] = take(file, 'map', {'V', 'sheet', 'p', 'u'}, [n n n+1 n+1]);
varied = find(cellfun(@numel, nodes) > 1);              % along a single node nothing can be interpolated
% u at states by linear interpolation. u jumps between sheets: nodes of other sheets are left out, cells with one NaN.
for i = 1:size(x0, 1)
    to = num2cell(x0(i, :));
    [~, near] = cellfun(@(g, xi) min(abs(g - xi)), nodes, to, 'UniformOutput', false);
    for c = 1:size(u0, 2)
        one = component(u, c, value);
        one(sheet ~= sheet(near{:})) = NaN;
        at(i, c) = interpn(nodes{varied}, squeeze(one), to{varied});
    end
end
known = find(all(~isnan(at - u0), 2));
i = known(ceil(end / 3));
text = cellfun(@(a) mat2str(a(i, :), 6), {x0, at, u0}, 'UniformOutput', false);
fprintf('x = %s: u of the map %s, solved for there %s\n', text{:});

% What must hold, up to the errors of differences (hence the 2 %): H = 0 and dV = p . dx along trajectories, p = dV/dx
% on the map (of even spacing), and the map's u at the states that were solved one by one.
median_of = @(a) median(a(~isnan(a)));
dV = diff(V, 1, 2);
pdx = sum((p(:, 2:end, :) + p(:, 1:end-1, :)) / 2 .* diff(x, 1, 2), 3);
check('|H| / running cost', max(abs(H(:))) / median_of(-dV ./ diff(t, 1, 2)));
check('dV - p.dx', median_of(abs(pdx ./ dV - 1)));
check('u of map - points', median_of(abs(at(known, :) - u0(known, :))) / max(abs(u(:))));
for k = varied
    first = [k, 1:k-1, k+1:n];                          % axis k brought to the front
    [along, slope] = deal(permute(component(costate, k, value), first), permute(value, first));
    [along, slope] = deal((along(2:end, :) + along(1:end-1, :)) / 2, diff(slope(:, :)) / (nodes{k}(2) - nodes{k}(1)));
    check(['dV/d' names{k} ' - p'], median_of(abs(slope - along)) / median_of(abs(slope)));
end
end

function varargout = take(file, group, names, axes)
% Axes come out of ncread reversed, V as (omega, theta), as here the first index runs fastest: this turns them back.
varargout = cellfun(@(name, n) permute(ncread(file, ['/' group '/' name]), n:-1:1), names, num2cell(axes), ...
                    'UniformOutput', false);
end

function a = component(a, k, like)
a = reshape(a((k - 1) * numel(like) + (1:numel(like))), size(like));       % a(:, ..., :, k)
end

function check(what, deviation)
fprintf('%-20s %.1e\n', what, deviation);
assert(deviation < 0.02, 'read_result: %s: off by more than 2 %%', what);  % NaN fails as well
end
