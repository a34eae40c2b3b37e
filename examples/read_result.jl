# Reads a result file in Julia: u at a state, and checks; exits 1 where one fails.
#     julia examples/read_result.jl out/pendulum.h5
# Needs HDF5.jl (julia -e 'import Pkg; Pkg.add("HDF5")'). The scene needs [shoot_out], [homotopy] and [map].
using HDF5, Statistics

# Axes come out reversed, V as (omega, theta), as in Julia the first index runs fastest: this turns them back.
turn(a) = permutedims(a, ndims(a):-1:1)
take(path, group, names) = [turn(h5read(path, "$group/$name")) for name in names]

# u at x, linear within a cell of the map. It jumps between sheets: a cell with corners on several gives NaN.
function law(x, nodes, sheet, u)
    n = length(x)
    low = [clamp(searchsortedlast(g, xi), 1, max(length(g) - 1, 1)) for (g, xi) in zip(nodes, x)]
    share = [length(g) == 1 ? 0.0 : (xi - g[i]) / (g[i + 1] - g[i]) for (g, i, xi) in zip(nodes, low, x)]
    near = low .+ (share .> 0.5)
    result = all(0 .<= share .<= 1) ? zeros(size(u, n + 1)) : fill(NaN, size(u, n + 1))
    for corner in Iterators.product(fill(0:1, n)...)
        weight = prod(corner[k] == 1 ? share[k] : 1 - share[k] for k in 1:n)
        weight == 0 && continue
        node = [low[k] + corner[k] for k in 1:n]
        result .+= sheet[node...] == sheet[near...] ? weight .* u[node..., :] : NaN
    end
    return result
end

function main(path)
    names = h5read(path, "map/state")                       # the map's axes are named like the states
    nodes = [h5read(path, "map/$name") for name in names]
    n = length(names)
    t, x, p, V, H = take(path, "trajectories", ["t", "x", "p", "V", "H"])  # (trajectory, sample, state)
    x0, u0 = take(path, "points", ["x0", "u"])                             # (point, state or control)
    value, sheet, costate, u = take(path, "map", ["V", "sheet", "p", "u"]) # (state 1, ..., state n, state or control)

    at = permutedims(reduce(hcat, [law(x0[i, :], nodes, sheet, u) for i in axes(x0, 1)]))
    known = findall(vec(all(!isnan, at .- u0, dims = 2)))
    one = known[cld(length(known), 3)]
    println("x = ", x0[one, :], ": u of the map ", at[one, :], ", solved for there ", u0[one, :])

    # What must hold, up to the errors of differences (hence the 2 %): H = 0 and dV = p . dx along trajectories,
    # p = dV/dx on the map (of even spacing), and the map's u at the states that were solved one by one.
    valid(a) = filter(!isnan, vec(a))
    dV = diff(V, dims = 2)
    pdx = sum((p[:, 2:end, :] .+ p[:, 1:end-1, :]) ./ 2 .* diff(x, dims = 2), dims = 3)[:, :, 1]
    errors = ["|H| / running cost" => maximum(abs, valid(H)) / median(valid(-dV ./ diff(t, dims = 2))),
              "dV - p.dx" => median(valid(abs.(pdx ./ dV .- 1))),
              "u of map - points" => median(valid(abs.(at .- u0))) / maximum(abs, valid(u))]
    for k in findall(length.(nodes) .> 1)
        slope = diff(value, dims = k) ./ (nodes[k][2] - nodes[k][1])
        along, count = selectdim(costate, n + 1, k), length(nodes[k])
        along = (selectdim(along, k, 2:count) .+ selectdim(along, k, 1:count-1)) ./ 2
        push!(errors, "dV/d$(names[k]) - p" => median(valid(abs.(slope .- along))) / median(valid(abs.(slope))))
    end
    for (what, deviation) in errors
        println(rpad(what, 20), round(deviation, sigdigits = 2))
        deviation < 0.02 || error("$what: off by more than 2 %")  # NaN fails as well
    end
end

main(ARGS[1])
