"""The learn step in float64 NumPy without the package: forward, backward, Adam, soft update."""

import numpy as np


class Oracle:
    """A network of one hidden ReLU layer, its target copy, and Adam."""

    def __init__(self, q_weights, q_hat_weights, alpha):
        self.q = [np.asarray(w, np.float64) for w in q_weights]
        self.q_hat = [np.asarray(w, np.float64) for w in q_hat_weights]
        self.alpha = alpha
        self.m = [np.zeros_like(w) for w in self.q]
        self.v = [np.zeros_like(w) for w in self.q]
        self.num_steps = 0

    def learn(self, experiences, gamma, tau):
        states, actions, rewards, next_states, terminal_states = experiences
        rows = np.arange(len(actions))

        w1, b1, w2, b2 = self.q_hat
        best_next = (np.maximum(next_states @ w1 + b1, 0) @ w2 + b2).max(axis=1)
        y = np.where(terminal_states == 1, rewards, rewards + gamma * best_next)

        w1, b1, w2, b2 = self.q
        z = states.astype(np.float64) @ w1 + b1
        hidden = np.maximum(z, 0)
        q = hidden @ w2 + b2
        error = q[rows, actions] - y
        loss = (error**2).mean()

        d_q = np.zeros_like(q)
        d_q[rows, actions] = 2 * error / len(error)
        d_z = (d_q @ w2.T) * (z > 0)
        gradients = [states.T @ d_z, d_z.sum(axis=0), hidden.T @ d_q, d_q.sum(axis=0)]

        self.num_steps += 1
        for i, g in enumerate(gradients):
            self.m[i] = 0.9 * self.m[i] + 0.1 * g
            self.v[i] = 0.999 * self.v[i] + 0.001 * g**2
            m_hat = self.m[i] / (1 - 0.9**self.num_steps)
            v_hat = self.v[i] / (1 - 0.999**self.num_steps)
            # Keras adds epsilon to the uncorrected root (Kingma and Ba's remark at the end of section 2)
            root = np.sqrt(v_hat) + 1e-7 / np.sqrt(1 - 0.999**self.num_steps)
            self.q[i] = self.q[i] - self.alpha * m_hat / root
            self.q_hat[i] = tau * self.q[i] + (1 - tau) * self.q_hat[i]
        return loss, y, gradients
