function tables = lookup_tables(file, out)
% LOOKUP_TABLES  V and u of a result file's grid as n-D look-up tables, for MATLAB, Octave and Simulink.
%     tables = lookup_tables('out/pendulum.h5');              % tables.names, .axes{k}, .V, .u{c}, .known
%     lookup_tables('out/pendulum.h5', 'tables.mat');         % the same in a file
%     u = interpn(tables.axes{:}, tables.u{1}, 0.5, 2.0)      % MATLAB also: griddedInterpolant(tables.axes, tables.u{1})
% Simulink, block n-D Lookup Table: "Table data" tables.u{1}, "Breakpoints 1" tables.axes{1} and so on, extrapolation "Clip".
% Where V is not known the tables have the value of the nearest point that is, and .known is 0: a table for a switch to
% another law. A map to an error ([map] error) has no grid: `costate value FILE.h5 --grid ... --out GRID.h5` makes one.
% u jumps between sheets: interpolation across the jump is neither way's control; take a fine grid, or the C header.
if exist('OCTAVE_VERSION', 'builtin'), pkg('load', 'netcdf'); import_netcdf; end
ncid = netcdf.open(file, 'NC_NOWRITE');
map = netcdf.inqNcid(ncid, 'map');
[~, ~, dims] = netcdf.inqVar(map, netcdf.inqVarID(map, 'V'));
n = numel(dims);
for k = 1:n                                             % axes are named like the states
    names{k} = netcdf.inqDim(map, dims(n + 1 - k));
    nodes = ncread(file, ['/map/' names{k}]);
    axes{k} = nodes(:).';
end
netcdf.close(ncid);
V = permute(ncread(file, '/map/V'), n:-1:1);            % ncread has the last axis first
u = permute(ncread(file, '/map/u'), n+1:-1:1);
known = ~isnan(V);
if ~any(known(:)), error('V is known nowhere in %s', file); end

% The nearest known point of each, distances in widths of the axes.
where = cell(1, n);
[where{:}] = ind2sub(size(V), (1:numel(V)).');
place = zeros(numel(V), n);
for k = 1:n
    width = max(axes{k}(end) - axes{k}(1), eps);
    place(:, k) = axes{k}(where{k}) / width;
end
there = find(known);
from = (1:numel(V)).';
for i = find(~known(:)).'
    [~, j] = min(sum((place(there, :) - place(i, :)).^2, 2));
    from(i) = there(j);
end
tables.names = names;
tables.axes = axes;
tables.V = reshape(V(from), size(V));
for c = 1:size(u, n + 1)
    one = u((c - 1) * numel(V) + (1:numel(V)));
    tables.u{c} = reshape(one(from), size(V));
end
tables.known = double(known);
if nargin > 1, save(out, '-struct', 'tables', '-v7'); end
end
