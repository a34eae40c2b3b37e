"""V of 20 random states of scenarios/satellite.toml or quadrotor.toml by direct collocation (Radau, 50 intervals of degree 5) and IPOPT, against a
map: python by_collocation.py satellite|quadrotor MAP.h5 [COSTATE] (casadi, scipy). Nothing of costate is used for the referee."""
import csv, os, subprocess, sys, tempfile
import casadi as ca, numpy as np, scipy.linalg as sl


def linearize(f, L, n, m, xe, ue):
    """A, B, P, K of the linear-quadratic problem at (xe, ue)."""
    x, u = ca.SX.sym('x', n), ca.SX.sym('u', m); z = ca.vertcat(x, u); at = lambda e: np.array(ca.Function('g', [x, u], [e])(xe, ue))
    A, B, H = at(ca.jacobian(f(x, u), x)), at(ca.jacobian(f(x, u), u)), at(ca.hessian(L(x, u), z)[0])
    P = sl.solve_continuous_are(A, B, H[:n, :n], H[n:, n:], s=H[:n, n:])
    return A, B, P, np.linalg.solve(H[n:, n:], B.T @ P + H[n:, :n])


def weights(c):
    """Quadrature weights of the nodes c on [0, 1]."""
    d = len(c); return np.linalg.solve(np.vander(c, increasing=True).T, 1/np.arange(1, d+1))


def solve(f, L, n, m, x0, T, end, lower=None, upper=None, intervals=60, degree=5, stretch=1.0, guess=None, control=None, tol=1e-11):
    """f(x, u), L(x, u): casadi expressions; end(x): terminal cost (infinite horizon: 1/2 (x - xe)'P(x - xe) at a T long enough); stretch > 1: intervals grow.
    guess(t), control(t): first trajectory. Returns V, p (= -multipliers of x(0) = x0), u at the first node, success, states, controls, times."""
    tau = np.append(0, ca.collocation_points(degree, 'radau')); w = weights(tau[1:])
    lag = [np.poly1d(np.poly(np.delete(tau, j)))/np.prod(tau[j]-np.delete(tau, j)) for j in range(degree+1)]
    C = np.array([[np.polyder(p)(t) for t in tau] for p in lag]); h = stretch**np.arange(intervals); t = np.concatenate([[0], np.cumsum(h)/h.sum()*T])
    x, u = ca.SX.sym('x', n), ca.SX.sym('u', m); F = ca.Function('F', [x, u], [f(x, u), L(x, u)])
    guess = guess or (lambda s: np.array(x0)*np.exp(-s)); control = control or (lambda s: np.zeros(m))
    lo, hi = (list(lower) if lower is not None else [-np.inf]*m), (list(upper) if upper is not None else [np.inf]*m)
    X = ca.MX.sym('X0', n); var, lb, ub, first, g, J = [X], [-np.inf]*n, [np.inf]*n, list(x0), [X-ca.DM(x0)], 0
    for k in range(intervals):
        dt = t[k+1]-t[k]; Xs = [ca.MX.sym('X', n) for _ in range(degree)]; Us = [ca.MX.sym('U', m) for _ in range(degree)]
        for j in range(degree):
            s = t[k]+dt*tau[j+1]; var += [Xs[j], Us[j]]; lb += [-np.inf]*n+lo; ub += [np.inf]*n+hi; first += list(guess(s))+list(control(s))
            rate, cost = F(Xs[j], Us[j]); J += dt*w[j]*cost
            g.append(C[0, j+1]*X+sum(C[r+1, j+1]*Xs[r] for r in range(degree))-dt*rate)
        X = Xs[-1]
    o = {'ipopt.print_level': 0, 'print_time': 0, 'ipopt.sb': 'yes', 'ipopt.tol': tol, 'ipopt.acceptable_tol': tol, 'ipopt.max_iter': 1000, 'ipopt.bound_relax_factor': 0}
    s = ca.nlpsol('s', 'ipopt', {'x': ca.vertcat(*var), 'f': J+end(X), 'g': ca.vertcat(*g)}, o); r = s(x0=first, lbx=lb, ubx=ub, lbg=0, ubg=0)
    v = np.array(r['x']).ravel(); body = v[n:].reshape(-1, n+m)
    return dict(V=float(r['f']), p=-np.array(r['lam_g'][:n]).ravel(), u=body[0, n:], ok=s.stats()['success'], X=body[:, :n], U=body[:, n:], t=np.concatenate([t[k]+(t[k+1]-t[k])*tau[1:] for k in range(intervals)]))



what, MAP = sys.argv[1:3]; C = sys.argv[3] if len(sys.argv) > 3 else 'target/release/costate'; tmp = tempfile.mkdtemp(); ASK, TOLD = (os.path.join(tmp, n) for n in ('ask.csv', 'told.csv'))
if what=='satellite':
    n,m=6,3; lim=[.5236]*3+[.3927]*3; names='phi,theta,psi,w1,w2,w3'; T=40.
    def f(x,u):
        phi,th,psi,w1,w2,w3=[x[i] for i in range(6)]; u1,u2,u3=[u[i] for i in range(3)]; c,s=ca.cos,ca.sin
        r1=c(th)*c(psi)+c(th)*s(psi)-s(th)
        r2=s(phi)*s(th)*c(psi)-c(phi)*s(psi)+s(phi)*s(th)*s(psi)+c(phi)*c(psi)+c(th)*s(phi)
        r3=c(phi)*s(th)*c(psi)+s(phi)*s(psi)+c(phi)*s(th)*s(psi)-s(phi)*c(psi)+c(th)*c(phi)
        return ca.vertcat(w1+s(phi)*ca.tan(th)*w2+c(phi)*ca.tan(th)*w3, c(phi)*w2-s(phi)*w3,(s(phi)*w2+c(phi)*w3)/c(th),
          (w3*r2-w2*r3+u1+u2/20+u3/10)/2,(-w3*r1+w1*r3+u1/15+u2+u3/10)/3,(w2*r1-w1*r2+u1/10+u2/15+u3)/4)
    L=lambda x,u: .5*(x[0]**2+x[1]**2+x[2]**2)+5*(x[3]**2+x[4]**2+x[5]**2)+.25*(u[0]**2+u[1]**2+u[2]**2); ue=[0]*3
else:
    n,m=5,2; lim=[1,1.5,1.5,.7,1.5]; names='z,vx,vz,phi,omega'; T=12.; g=9.81
    f=lambda x,u: ca.vertcat(x[2],-u[0]*ca.sin(x[3]),u[0]*ca.cos(x[3])-g,x[4],u[1])
    L=lambda x,u:.5*(2*x[0]**2+x[1]**2+x[2]**2+x[3]**2+.2*x[4]**2+.2*(u[0]-g)**2+.1*u[1]**2); ue=[g,0]
A,B,P,K=linearize(f,L,n,m,[0]*n,ue); P=ca.DM(P)
rng=np.random.default_rng(5); X=rng.uniform(-1,1,(20,n))*lim
np.savetxt(ASK,X,delimiter=',',header=names,comments='',fmt='%.17g')
subprocess.run([C,'value',MAP,'--points',ASK,'--out',TOLD,'--quiet'],stdout=subprocess.DEVNULL)
R=list(csv.DictReader(open(TOLD)))
e,b=[],[]
for x,r in zip(X,R):
    s=solve(f,L,n,m,x,T,lambda x:.5*ca.mtimes([x.T,P,x]),intervals=50,degree=5,stretch=1.04,tol=1e-10,control=lambda t:np.array(ue,float))
    if not r['V']: print(x,'unknown',s['V']); continue
    e.append(abs(float(r['V'])-s['V'])/s['V']); b.append(abs(float(r['V'])-s['V'])/float(r['V_error']))
    print(s['ok'],s['V'],r['V'],'%.1e'%e[-1],'%.2f'%b[-1],flush=True)
print(what,MAP,len(e),'known; relative error median %.1e largest %.1e; over bound largest %.2f'%(np.median(e),max(e),max(b)))
