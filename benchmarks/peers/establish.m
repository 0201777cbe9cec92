% The undamped law of the paper under ode45: octave-cli establish.m FOLDER
%
% FOLDER/agents: mass, position, force of each agent; FOLDER/edges: agents from 1, distance;
% FOLDER/numbers: alpha, beta, gamma, duration, tolerance. Writes FOLDER/end: seconds, positions.
1;

function dy = law (y, p)
  N = p.N;
  r = reshape (y(1:3*N), 3, N);
  v = reshape (y(3*N+1:6*N), 3, N);
  integral = y(6*N+1:end);
  difference = r(:, p.i) - r(:, p.j);
  rate = v(:, p.i) - v(:, p.j);
  L = sqrt (sum (difference .^ 2, 1));
  u = difference ./ L;
  J = zeros (numel (p.i), 3*N);
  for k = 1:3
    J(p.at_i + (k - 1) * rows (J)) = u(k, :);
    J(p.at_j + (k - 1) * rows (J)) = -u(k, :);
  end
  c = L' - p.d;
  c_dot = J * v(:);
  J_dot_v = ((sum (rate .^ 2, 1) - sum (u .* rate, 1) .^ 2) ./ L)';
  b = -J_dot_v - J * (p.f ./ p.M) - 2 * p.alpha * c_dot - p.beta ^ 2 * c - p.gamma * integral;
  lambda = (J * (J' ./ p.M)) \ b;
  dy = [v(:); (p.f + J' * lambda) ./ p.M; c];
end

folder = argv (){end};
agents = load (fullfile (folder, "agents"));
edges = load (fullfile (folder, "edges"));
numbers = load (fullfile (folder, "numbers"));
p.N = rows (agents);
p.M = kron (agents(:, 1), ones (3, 1));
p.f = agents(:, 5:7)'(:);
p.i = edges(:, 1);
p.j = edges(:, 2);
p.d = edges(:, 3);
p.alpha = numbers(1);
p.beta = numbers(2);
p.gamma = numbers(3);
% Places in J of the first entry of each edge's agents; an agent's next entries are a column further.
k = (1:rows (edges))';
p.at_i = k + (p.i - 1) * 3 * rows (edges);
p.at_j = k + (p.j - 1) * 3 * rows (edges);
start = [agents(:, 2:4)'(:); zeros(3 * p.N + rows (edges), 1)];
options = odeset ("RelTol", numbers(5), "AbsTol", numbers(5));
tic;
[t, y] = ode45 (@(t, y) law (y, p), [0, numbers(4)], start, options);
seconds = toc;
out = [seconds; y(end, 1:3*p.N)'];
save ("-ascii", "-double", fullfile (folder, "end"), "out");
