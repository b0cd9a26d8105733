"""The extended Kalman filter of the paper, measurements that arrive late, and its tie to the map."""
